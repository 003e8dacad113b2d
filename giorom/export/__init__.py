"""Motions as files for other programs: HDF5, VTKHDF, PLY, pictures and films."""
