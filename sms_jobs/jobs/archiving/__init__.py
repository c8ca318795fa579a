"""The way into the archive: files are sealed and indexed, or leave nothing behind."""
