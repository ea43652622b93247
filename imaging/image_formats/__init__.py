"""Images of CCDs as other programs write them: one reader for each convention of files."""
