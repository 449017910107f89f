"""`python -m torchmeso`: the command line."""

from torchmeso.cli import main

main()
