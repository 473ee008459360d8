"""`python -m binpick` is `binpick`."""

from binpick.cli import main

main()
