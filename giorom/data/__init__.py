"""Trajectories on disk: files, data sets, statistics, foreign formats."""
