"""Files of telescopes, one folder for each format."""
