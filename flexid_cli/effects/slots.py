"""Places of the signals in the workspace that the torque laws read and write.

A law sees the axis at one instant. What stands in a slot when it is called depends on the law's stage (`base.Stage`):
each stage starts from what the stages before it left. All values are joint side, SI.

The numbers are compiled into cached machine code: add at the end, never renumber.
"""

from __future__ import annotations

TIME = 0
COMMAND = 1  # torque that the controller asks for (and records)
TORQUE = 2  # torque that acts, Stage.LIMIT and Stage.LAG change it
MOTOR_POSITION = 3
MOTOR_VELOCITY = 4
JOINT_POSITION = 5
JOINT_VELOCITY = 6
TORSION = 7  # d = qm - q, Stage.KINEMATICS changes it
TORSION_RATE = 8  # d'
GEAR = 9  # partial derivative of d with respect to qm: the motor feels GEAR * T (virtual work)
SPRING_TORSION = 10  # what the spring feels of d, Stage.CONTACT changes it
JOINT_TORQUE = 11  # T, Stage.TRANSMISSION adds to it
MOTOR_TORQUE = 12  # what the motor torque must overcome beside inertia, T and Coulomb friction
MOTOR_COULOMB = 13  # level that is multiplied by sgn qm'
LOAD_TORQUE = 14  # the same of the load
LOAD_COULOMB = 15
MOTOR_INERTIA = 16  # as it is now
LOAD_INERTIA = 17
MEASURED_MOTOR = 18  # what the encoders show, Stage.MEASUREMENT changes it
MEASURED_MOTOR_RATE = 19  # derivative of what they show
MEASURED_JOINT = 20
MEASURED_JOINT_RATE = 21
MOTOR_DELAY = 22  # age of what the encoders show, s
JOINT_DELAY = 23
# Parameters of the axis: constant, for reading.
JM = 24
K = 25
JL = 26
FVM = 27
FSM = 28
FV = 29
FS = 30
MX = 31
MY = 32
GRAVITY = 33
OFFSET = 34
MOTOR_WIDTH = 35  # v0 of tanh(v / v0); 0: set-valued
LOAD_WIDTH = 36
# The kernel's own.
DRIVEN = 37  # 1: the motor position is prescribed
MOTOR_MODE = 38  # -1, 1: slips this way; 0: sticks (set-valued friction only)
LOAD_MODE = 39
MOTOR_ACCELERATION = 40
JOINT_ACCELERATION = 41
MOTOR_NET = 42  # torque that friction must hold or else acceleration follows
LOAD_NET = 43
INTERVAL_START = 44
INPUT = 45  # six coefficients of the input's polynomial in the time since INTERVAL_START
SIZE = 56
