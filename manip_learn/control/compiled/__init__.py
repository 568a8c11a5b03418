"""The law of `controller` as loops over plain numbers: compiled where numba is installed, plain Python in the tests."""
