"""One module per family of file formats; `geomoe3d.clouds.io` chooses among them by suffix."""
