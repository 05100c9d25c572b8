"""`python -m splatcli`, where the `splat` script is not on the path."""

from splatcli.app import main

main()
