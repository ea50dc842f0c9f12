"""Pictures from elsewhere as datasets on disk, a file a kind of source."""
