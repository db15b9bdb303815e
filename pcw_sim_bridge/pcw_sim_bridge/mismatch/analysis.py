"""From recordings and a description to findings. (Being written by the lead.)"""
