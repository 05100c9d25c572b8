"""Learned features and matches, for photographs that SIFT leaves out.

In reading order: `joining` (the step, in the worker process), `features` (XFeat), `matching`
(LighterGlue), `weights` (where their weights are).
"""
