"""A job service with a data archive for optical shape, deformation and strain measurement."""

from importlib.metadata import version

__version__ = version("sms-jobs")
