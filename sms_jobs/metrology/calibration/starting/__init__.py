"""First values of sensors and poses, before they are adjusted."""
