"""Robot descriptions (URDF, MJCF, xacro): read, validated and repaired before Pinocchio sees them."""
