"""Where the home is and which servers are used."""
