"""What is shown of a home and never archived: files that were found, estimates, what is known of a test."""
