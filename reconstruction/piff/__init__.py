"""PSF models of Piff: its files read without Piff and without pickle, drawn, and compared with ours."""
