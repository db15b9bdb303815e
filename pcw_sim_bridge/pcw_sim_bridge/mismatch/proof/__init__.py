"""The proof of a patch on recordings, or manoeuvres, that its fit has not seen."""
