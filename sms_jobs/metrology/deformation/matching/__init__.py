"""Matching of subsets between images, of one camera in time or of two cameras."""
