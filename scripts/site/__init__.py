"""Generate the parts of the site that are read from the program: keys, commands and public names."""
