"""The pages of the console: a module for each subject, whose `PAGES` are found by themselves."""
