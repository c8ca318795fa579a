"""`sms calibration`: calibrations of rigs."""
