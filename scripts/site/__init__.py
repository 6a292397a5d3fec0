"""What the site is made from beside its pages: keys, commands and public names, read from the program itself."""
