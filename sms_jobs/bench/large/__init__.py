"""Catalogues, queues and tuples of real size."""
