"""Simulation of the axis and its controller."""
