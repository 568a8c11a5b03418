"""Robotics Toolbox: its Jacobian, and its manipulability Jacobian in the null space."""

import warnings

import numpy as np

warnings.simplefilter("ignore")  # it warns about its own escapes while it is imported

import roboticstoolbox as rtb  # noqa: E402
from driving import TARGET, TIP, URDF, answer, drive, main, report  # noqa: E402


def step():
    """Without and with null-space motion."""
    robot = rtb.Robot.URDF(URDF)
    end = robot.link_dict[TIP]

    def task_only(q):
        """J^+ (target - position)."""
        J = robot.jacob0(q, end=end)[:3]
        return np.linalg.pinv(J) @ (TARGET - robot.fkine(q, end=end).t)

    def with_manipulability(q):
        """The same with the gradient of mu in the null space."""
        J = robot.jacob0(q, end=end)[:3]
        inverse = np.linalg.pinv(J)
        climb = robot.jacobm(q, end=end, axes="trans").reshape(-1)
        return inverse @ (TARGET - robot.fkine(q, end=end).t) + (np.eye(7) - inverse @ J) @ climb

    steps = {"task only": task_only, "with manipulability": with_manipulability}
    report("roboticstoolbox-python", steps, calls=50)


def stepper(manipulability):
    """A^+ b, and the gradient of its mu of all three axes in the null space."""

    def make(arm, case):
        robot = rtb.Robot.URDF(arm.urdf)
        end = robot.link_dict[arm.tip]
        moving = sorted((link for link in robot.links if link.isjoint), key=lambda link: link.jindex)
        order = [[link._joint_name for link in moving].index(n) for n in arm.names]
        branch = robot.ets(end=end).jindices  # its Jacobian has no columns for joints elsewhere, a second arm's

        def step(q):
            full = np.empty(robot.n)
            full[order] = q
            A, climb = np.zeros((len(case.rows), robot.n)), np.zeros(robot.n)
            A[:, branch] = case.rows @ robot.jacob0(full, end=end)[:3]
            inverse = np.linalg.pinv(A)
            u = inverse @ (arm.task_gain * case.rows @ (case.target - robot.fkine(full, end=end).t))
            if manipulability:
                climb[branch] = case.gain * robot.jacobm(full, end=end, axes="trans").reshape(-1)
                u = u + climb - inverse @ (A @ climb)
            return u[order]

        return step

    return make


METHODS = {"roboticstoolbox": stepper(False), "roboticstoolbox, jacobm": stepper(True)}

if __name__ == "__main__":
    main(
        step=step,
        control=lambda *files: drive("roboticstoolbox-python", *files, METHODS),
        timings=lambda: answer("roboticstoolbox-python", METHODS),
    )
