"""What two cameras measure, beside exact truth and other programs."""
