"""A rig made of light rays: renders what real cameras would see, and knows the exact truth."""
