"""MJCF of robots with legs of three joints that no one has seen before."""

LEG = """<body name="{name}_hip" pos="{x} {y} 0"><inertial mass="0.05" pos="0 0 0"
    diaginertia="1e-5 1e-5 1e-5"/><joint name="{name}_roll" axis="1 0 0" range="-0.6 0.6"/>
  <body name="{name}_thigh" pos="0 {out} 0"><joint name="{name}_pitch" axis="0 1 0" range="-1 2"/>
    <inertial mass="0.05" pos="0 0 -0.05" diaginertia="1e-5 1e-5 1e-5"/>
    <body name="{name}_shank" pos="0 0 -0.1"><joint name="{name}_knee" axis="0 {knee} 0"
        range="-2.5 2.5"/><inertial mass="0.03" pos="0 0 -0.05" diaginertia="1e-5 1e-5 1e-5"/>
      <geom type="sphere" size="0.01" pos="0 0 -0.1"/></body></body></body>"""
"""Two parts of 0.1 m with a foot; out to the side by `out`."""


def legged(
    legs: dict[str, tuple[int, int]], base: str = "<freejoint/>", more: str = "",
    mirrored: bool = True,
) -> str:  # fmt: skip
    """A robot with a leg at each place: before the middle, and to the left, in steps.

    Its right knees turn the other way round if it is `mirrored`.
    """
    made = "".join(
        LEG.format(name=n, x=0.12 * fore, y=0.05 * side, out=0.04 * side,
                   knee=side if mirrored else 1)
        for n, (fore, side) in legs.items()
    )  # fmt: skip
    return f"""<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
      <body name="torso" pos="0 0 0.2">{base}<inertial mass="1" pos="0 0 0"
        diaginertia="0.01 0.01 0.01"/><geom type="box" size="0.1 0.04 0.03"/>{made}</body>
      </worldbody>{more}</mujoco>"""
