"""Engines that run many tasks on worker processes: on this machine, or on a Dask cluster."""
