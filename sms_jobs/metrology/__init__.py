"""Arrays in, arrays out: optics, ranging, correlation and strain, with no files, clock or logging.

OpenCV and scipy.optimize, which few functions need, are imported in these functions: whoever asks which job
kinds there are loads every module here. Places of workers have them from the start. Quantiles come from
scipy.special: nobody loads scipy.stats, half a second and 25 MB.
"""
