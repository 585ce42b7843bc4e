"""`mujoco.sysid` as its documentation shows it: a model, bounded parameters, a sensor delay."""

import mujoco
import numpy as np
from exchange import STEP_S, Fitted, serve
from mujoco import sysid

XML = f"""
<mujoco>
  <option timestep="{STEP_S}" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="joint" type="hinge" axis="0 0 1" armature="0.005"/>
      <inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="joint" kp="70" kv="1" forcerange="-5 5"/>
  </actuator>
  <sensor>
    <jointpos name="position" joint="joint"/>
  </sensor>
</mujoco>
"""


def friction(spec, parameter):
    spec.joint("joint").frictionloss = parameter.value[0]


def effort(spec, parameter):
    spec.actuator("servo").forcerange = [-parameter.value[0], parameter.value[0]]


def kp(spec, parameter):
    sysid.apply_pgain(spec, "servo", float(parameter.value[0]))


def kv(spec, parameter):
    sysid.apply_dgain(spec, "servo", float(parameter.value[0]))


def held(trial, grid):
    """Commands as they stood, relative to rest."""
    last = np.searchsorted(trial.command_time_s, grid, "right") - 1
    return trial.command_rad[np.maximum(last, 0)] - trial.rest_rad


def fit(trials):
    spec = mujoco.MjSpec.from_string(XML)
    model = spec.compile()
    rest = sysid.create_initial_state(model, np.zeros(1))
    parameters = sysid.ParameterDict()
    for name, nominal, low, high, modifier in (
        ("kp", 70.0, 2.0, 600.0, kp), ("kv", 1.0, 0.01, 10.0, kv),
        ("friction", 0.1, 0.0, 5.0, friction), ("effort", 3.0, 0.2, 20.0, effort),
        ("delay", 0.04, 0.0, 0.12, None), ("bias", 0.0, -2.0, 2.0, None),
    ):  # fmt: skip
        parameters.add(sysid.Parameter(name, nominal, low, high, modifier=modifier))
    transform = sysid.SignalTransform()
    transform.delay("position", parameters["delay"])
    transform.bias("position", parameters["bias"], target="predicted")
    sequences = sysid.ModelSequences(
        "servo", spec, [f"tone {n}" for n in range(len(trials))], [rest] * len(trials),
        [sysid.TimeSeries(t.grid_s, held(t, t.grid_s)[:, None]) for t in trials],
        [sysid.TimeSeries.from_names(t.time_s, (t.position_rad - t.rest_rad)[:, None], model)
         for t in trials],
    )  # fmt: skip
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=transform.apply, n_threads=1
    )
    found, result = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False)
    _, half = sysid.calculate_intervals(residual(result.x, found)[0], result.jac, alpha=0.1)
    delay, half = found["delay"].value[0], half[list(found.keys()).index("delay")]
    fitted = sysid.apply_param_modifiers(found, spec)

    def predict(trial):
        data = mujoco.MjData(fitted)
        path = []
        for command in held(trial, trial.grid_s):
            data.ctrl[0] = command
            path.append(data.qpos[0])
            mujoco.mj_step(fitted, data)
        late = np.interp(trial.grid_s - delay, trial.grid_s, path, left=0.0)
        return late + found["bias"].value[0] + trial.rest_rad

    return Fitted(predict, float(delay), STEP_S, (float(delay - half), float(delay + half)))


serve(fit)
