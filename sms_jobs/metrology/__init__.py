"""Arrays in, arrays out: optics, ranging, correlation and strain, with no files, clock or logging.

OpenCV, scipy.stats and scipy.optimize, 45 MB that few functions need, are imported in these functions:
whoever asks which job kinds there are loads every module here. Places of workers have them from the start.
"""
