"""What every estimator of a constraint must do with good, bad and odd demonstrations."""
