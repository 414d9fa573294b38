"""What carries a limb's two ends: one kind a file, behind the contract of ``contract.py``."""
