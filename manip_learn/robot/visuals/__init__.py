"""The look of a robot: visual elements, meshes and plain shapes."""
