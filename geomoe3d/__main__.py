"""``python -m geomoe3d``: the command line where its script is not on the path."""

from geomoe3d.cli.main import main

if __name__ == "__main__":
    main()
