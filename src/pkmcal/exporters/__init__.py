"""Export of machines to other programs: one format a file, by the contract of ``contract.py``."""
