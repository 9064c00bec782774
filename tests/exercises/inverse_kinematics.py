"""Solution of "Inverse kinematics": the joints of each pose, and a move to them."""

from control import Arm, joints_for

POSES = ((420, 150, 60, 45), (300, -300, 40, -30), (150, 420, 80, 90))


def main() -> None:
    arm = Arm()
    for pose in POSES:
        arm.move(joints_for(*pose), 1.8, rest=1.0)
    arm.close()


if __name__ == "__main__":
    main()
