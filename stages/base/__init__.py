"""Tools of all packages: errors, settings, the stage interface, files, memory, threads."""
