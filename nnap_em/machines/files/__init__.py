"""Machines from MJCF and URDF files."""
