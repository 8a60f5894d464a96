"""From recorded data to a decision: which plans can be verified, and which input is the closest safe one."""
