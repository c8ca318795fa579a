"""The interface `/api/v1`: a module for each subject, whose `ROUTES` are found by themselves."""
