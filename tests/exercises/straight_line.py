"""Solution of "Straight line": inverse kinematics of each point of the line."""

from control import Arm, joints_for

START, END = (400, -200, 60), (400, 200, 60)


def main() -> None:
    arm = Arm()
    arm.move(joints_for(*START), 1.5, rest=0.5)
    arm.line(START, END, 3.0, rest=0.5)
    arm.close()


if __name__ == "__main__":
    main()
