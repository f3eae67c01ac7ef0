"""One file, one shape: a module here *is* the shape of that name, and holds a ``Shape``."""
