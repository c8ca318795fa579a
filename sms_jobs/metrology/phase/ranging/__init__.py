"""The parts of Fourier domain ranging: signal, transform, and the fits of one, two and more returns."""
