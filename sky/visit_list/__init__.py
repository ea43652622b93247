"""Lists of visits of schedulers and observatories: files, their columns, and what they say of each visit."""
