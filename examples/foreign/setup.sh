#!/bin/sh
# Another author's package in a virtual environment of its own (Python 3.11): its versions do not go with ours.
# sh setup.sh safety_gymnasium safety-gymnasium==1.0.0
set -e
here=$(dirname "$0")/../$1
"${PYTHON:-python3.11}" -m venv "$here/.venv"
"$here/.venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$here/requirements.txt"
"$here/.venv/bin/pip" install --quiet --disable-pip-version-check --no-deps "$2"
touch "$here/.venv/.installed"  # a half-made one is made again
