"""Compact models of the desk, made of layers: what is behind, what is pushed, and the arm.

:mod:`colours` finds coloured parts; :mod:`backdrop` what stands still or slides, and draws it
without anything in front; :mod:`arm` what moves before it, and where the hand is; :mod:`cell` how
an action changes all this; :mod:`dynamics` puts them together.
"""
