"""Solution of "Move between two poses": quintic moves with the model as feedforward."""

from control import Arm, joints

A, B = joints(30, -45, 50, 20), joints(-20, 60, 120, -30)


def main() -> None:
    arm = Arm()
    for goal in (A, B, A):
        arm.move(goal, 1.2, rest=1.0)
    arm.close()


if __name__ == "__main__":
    main()
