"""Kinds of limb ends: one file for each kind of joint, behind the contract of `contract`."""
