"""Kernels of text of our own, in line with Dr.Jit's, for what Dr.Jit cannot say or says slowly.

No recording takes in such a kernel: it is launched between recordings.
"""
