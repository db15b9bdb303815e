"""Findings as report.html, report.json, figures and a patched description. (Being written by a helper of the lead.)"""
