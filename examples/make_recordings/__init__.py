"""How the recordings in examples/data were made. Needs MuJoCo for the physics; no part of the library."""
