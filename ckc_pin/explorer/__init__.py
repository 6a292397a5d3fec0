"""The explorer: move, change and run a mechanism in the browser while its loops stay closed."""
