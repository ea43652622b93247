"""Workers that compute tasks: this process, processes of this machine, or a Dask cluster."""
