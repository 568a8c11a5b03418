"""Mechanisms that hold the hand: lines, planes, hinges, balls, screws and held orientations."""
