"""People, how they log in, what they did, and what they are notified of."""
