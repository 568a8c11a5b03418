"""Learning from demonstrations that are larger than memory, on this machine or on a dask cluster."""
