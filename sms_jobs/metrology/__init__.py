"""Arrays in, arrays out: optics, ranging, correlation and strain, with no files, clock or logging."""
