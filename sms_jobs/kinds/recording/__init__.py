"""Job kinds that record: with instruments, or on the virtual rig."""
