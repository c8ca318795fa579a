"""Fields of results: shown, sampled, compared and exported."""
