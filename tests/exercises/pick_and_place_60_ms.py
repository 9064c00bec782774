"""Solution of "Pick and place under 60 ms of latency": slower feedback, and a reference that is ahead of the arm."""

from control import Arm, joints_for

# Part, place (x, y, mm), and mass, kg.
MOVES = (((350, 180), (300, -210), 0.2), ((250, 300), (370, -210), 0.3))
OVER, PICK, PUT = 30.0, -29.0, -21.0


def main() -> None:
    arm = Arm(delay=0.06, rate=3.0)
    for part, place, mass in MOVES:
        arm.move(joints_for(*part, OVER), 2.0, rest=1.0)
        arm.move(joints_for(*part, PICK), 1.0, rest=1.0)
        arm.magnet(True, mass)
        arm.move(joints_for(*part, OVER), 1.0, rest=0.4)
        arm.move(joints_for(*place, OVER), 2.0, rest=1.0)
        arm.move(joints_for(*place, PUT), 1.0, rest=1.2)
        arm.magnet(False)
        arm.move(joints_for(*place, OVER), 1.0, rest=0.2)
    arm.close()


if __name__ == "__main__":
    main()
