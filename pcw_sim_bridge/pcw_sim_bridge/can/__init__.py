"""Drives on CAN buses: the drive interface and its two protocols, the emulator, and the tools around them.

python-can is loaded by `python_can` alone; everything else works on frames, and so in simulated time too.
"""
