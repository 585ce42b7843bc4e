#!/bin/sh
# Environments: one for compare.py; one for BAM (real_recordings.py --bam), which asks for Python
# 3.12 (give another with PYTHON312=...). PyTorch and hardware drivers are left out.
# Three more for check_exports.py: Newton, mjlab and Isaac Lab's actuators (Isaac Sim is left out),
# which run their exports.
set -eu
cd "$(dirname "$0")"
python3 -m venv .venv
.venv/bin/pip install --quiet "mujoco[sysid]==4.0.0"
"${PYTHON312:-python3.12}" -m venv .venv-bam
.venv-bam/bin/pip install --quiet "better-actuator-models==1.0.2" "optuna==5.0.0" "cmaes==0.13.1" wandb
python3 -m venv .venv-newton
.venv-newton/bin/pip install --quiet "newton==1.8.0" "mujoco~=3.17.0" "mujoco-warp~=3.17.0" "torch==2.13.0"
python3 -m venv .venv-mjlab
.venv-mjlab/bin/pip install --quiet "torch==2.13.0" && .venv-mjlab/bin/pip install --quiet "mjlab==1.6.0"
python3 -m venv .venv-isaaclab
.venv-isaaclab/bin/pip install --quiet "torch==2.13.0"
.venv-isaaclab/bin/pip install --quiet "mujoco==4.0.0" toml warp-lang trimesh usd-core packaging
.venv-isaaclab/bin/pip install --quiet --no-deps "isaaclab==2.3.2.post1"
echo "Ready: .venv/bin/python benchmarks/peers/compare.py"
