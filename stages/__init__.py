"""The pipeline: from photographs to an asset, in seven stages."""

# zlib first: pycolmap's bundled copy corrupts the heap when Python's own is loaded after it.
import zlib  # noqa: F401

from stages.base.threads import configure

configure()
