"""The proof of the analyser: cases with concealed effects, their blind analysis, and the score.

`make` writes recordings and a sealed answer file, `run` analyses the recordings without it, `score` compares. The analyser
imports nothing from here.
"""
