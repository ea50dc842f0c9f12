"""Trajectories of one's own: tables, CCSDS messages, SPICE kernels, poses from Python; each becomes a rig."""
