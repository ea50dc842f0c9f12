"""Whether a dataset on disk is what was written."""
