"""Which effects a recording needs: sets grown, made exact, pruned and compared, and laws that none of them holds."""
