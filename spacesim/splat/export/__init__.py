"""A trained model as files: PLY, meshes, pictures, videos."""
