"""Simulation of the axis, its controller and every effect.

from flexid_cli.simulate.engine import simulate_closed_loop, simulate_motor_driven, simulate_torque_driven
from flexid_cli.simulate.machine import ACCURATE, Axis, Controller, InitialState, Sensors, Solver, Trajectory
from flexid_cli.effects.base import EffectValues

run = simulate_closed_loop(
    Axis(), Controller(8.0, 3000.0, 8000.0), reference, 1000.0,
    effects=(EffectValues("backlash", {"gap": 1e-3}),), sensors=Sensors(motor_resolution=2e-6), seed=1,
)
run.torque, run.motor_position, run.joint_position      # as recorded
run.torsion, run.joint_torque, run.states               # the truth behind it
"""
