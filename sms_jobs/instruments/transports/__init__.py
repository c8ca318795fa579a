"""Ways for bytes to reach a device: a serial port, a pseudo-terminal, memory."""
