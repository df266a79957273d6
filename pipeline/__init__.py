"""What every stage shares: the campaign folder, records with units, file formats, errors, caching, the report."""
