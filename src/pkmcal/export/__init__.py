"""A machine for other programs: one format a file, behind the contract of ``contract.py``."""
