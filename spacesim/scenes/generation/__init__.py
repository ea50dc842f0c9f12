"""A scene to a dataset on disk: frames in one process, in several, on a cluster."""
