"""Devices that record: here simulated ones over the virtual rig."""
