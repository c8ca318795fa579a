"""`sms import`: measurements, images, boards and points of other programs."""
