"""The console and the interface over HTTP: they call the use cases of `app`, and decide nothing."""
