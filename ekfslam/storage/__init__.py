"""HDF5: the dialect of all files, and result archives."""
