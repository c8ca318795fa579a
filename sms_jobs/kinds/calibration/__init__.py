"""Job kinds that observe artefacts, and make a calibration of what was observed."""
