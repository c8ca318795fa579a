"""The report of a campaign: the pieces of its page, and the tables and maps on it."""
