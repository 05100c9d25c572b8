"""Learned features and matches, for photographs that SIFT leaves out."""
