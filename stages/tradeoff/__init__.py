"""The trade-off report of one run, and the comparison of two.

One run: `measurement` measures, into the values of `curves`; `report_text`, `plots` and `html`
present them in a `report`. Two runs: `comparison`, by `intervals`.
"""
