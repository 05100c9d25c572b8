"""Files of cameras that other programs know: one module a format, read and write."""
