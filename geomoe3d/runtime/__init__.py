"""Work around the method: files, journals, processes, threads, timing, provenance."""
