"""What draws fields in a browser, for the report and for the console: scripts, and the style of theirs."""
