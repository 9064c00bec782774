"""Solution of "Square with delay": the reference is ahead by the known delay, and the feedback is slower."""

from itertools import pairwise

from control import Arm, joints_for

CORNERS = ((300, -75, 60), (450, -75, 60), (450, 75, 60), (300, 75, 60), (300, -75, 60))


def main() -> None:
    arm = Arm(delay=0.04, rate=4.0)
    arm.move(joints_for(*CORNERS[0]), 2.0, rest=1.0)
    for start, end in pairwise(CORNERS):
        arm.line(start, end, 2.0, rest=0.2)
    arm.close()


if __name__ == "__main__":
    main()
