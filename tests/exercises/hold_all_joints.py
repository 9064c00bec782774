"""Solution of "Hold all joints": feedback with the model of the arm, which carries the weight of the quill."""

from control import Arm, joints


def main() -> None:
    arm = Arm()
    arm.move(joints(20, 40, 60, -30), 2.0, rest=3.0)
    arm.close()


if __name__ == "__main__":
    main()
