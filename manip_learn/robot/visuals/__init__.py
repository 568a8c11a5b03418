"""What a robot looks like: visual elements, meshes and plain shapes."""
