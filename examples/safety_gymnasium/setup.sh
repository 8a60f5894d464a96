#!/bin/sh
# Safety-Gymnasium in a virtual environment of its own (Python 3.11): its versions do not go with ours.
set -e
here=$(dirname "$0")
"${PYTHON:-python3.11}" -m venv "$here/.venv"
"$here/.venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$here/requirements.txt"
"$here/.venv/bin/pip" install --quiet --disable-pip-version-check --no-deps safety-gymnasium==1.0.0
