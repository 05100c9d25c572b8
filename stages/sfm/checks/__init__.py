"""Configurations and their attempts, the gates that a result must pass, which one is accepted."""
