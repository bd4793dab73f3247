"""HDF5 archives."""
