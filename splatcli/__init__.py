"""The command line: parses arguments, calls the packages of `stages`, prints. No algorithms."""
