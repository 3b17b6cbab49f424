"""Whole data sets: blocks of items on the workers of a Dask cluster, and what is finished."""
