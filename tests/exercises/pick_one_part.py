"""Solution of "Pick one part": moves over the part, down, and to the tray, with the weight of the held part."""

from control import Arm, joints_for

PART, PLACE, MASS = (350, 180), (380, -160), 0.2
OVER, PICK, PUT = 30.0, -29.0, -21.0


def main() -> None:
    arm = Arm()
    arm.move(joints_for(*PART, OVER), 1.5)
    arm.move(joints_for(*PART, PICK), 0.8)
    arm.magnet(True, MASS)
    arm.move(joints_for(*PART, OVER), 0.8, rest=0.2)
    arm.move(joints_for(*PLACE, OVER), 1.5)
    arm.move(joints_for(*PLACE, PUT), 0.8)
    arm.magnet(False)
    arm.move(joints_for(*PLACE, OVER), 0.8, rest=0.2)
    arm.close()


if __name__ == "__main__":
    main()
