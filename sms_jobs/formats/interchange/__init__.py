"""Calibrations to and from other programs: OpenCV's file storage, and parameters as the thesis writes them.

Those of DICe, VIC-3D and MatchID are read too: a module here with a `FORMAT` is found by itself.

Files come from strangers. They are read by plain Python that knows only data: no tag makes an object, no
entity is expanded, size and depth are bounded, and every number is checked before it becomes a calibration.
"""
