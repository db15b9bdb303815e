"""Tyre-ground contact: one interface (`contact_model`), one file per friction curve."""
