"""Certificates for the tests of TLS: an authority, a server on 127.0.0.1 and a client."""

import datetime
import ipaddress

import pytest


def make_certificates(folder):
    """Write ca.pem, server.pem, server.key, client.pem, client.key, and locked.key, which has a password."""
    pytest.importorskip("cryptography", reason="the extra distributed is not installed")
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    def name(words):
        return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, words)])

    now = datetime.datetime.now(datetime.UTC)
    authority = ec.generate_private_key(ec.SECP256R1())

    def certify(key, words, is_authority=False):
        made = x509.CertificateBuilder(name("authority"), name(words), key.public_key(), x509.random_serial_number())
        made = made.not_valid_before(now - datetime.timedelta(days=1)).not_valid_after(now + datetime.timedelta(days=1))
        made = made.add_extension(x509.BasicConstraints(is_authority, None), critical=True)
        ids = x509.SubjectKeyIdentifier.from_public_key
        made = made.add_extension(ids(key.public_key()), critical=False)
        made = made.add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.public_key()), critical=False
        )
        if is_authority:
            usage = x509.KeyUsage(True, False, False, False, False, True, True, False, False)
            made = made.add_extension(usage, critical=True)
        else:
            names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
            made = made.add_extension(names, critical=False)
        return made.sign(authority, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)

    def plain(key, lock=None):
        lock = lock or serialization.NoEncryption()
        return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, lock)

    (folder / "ca.pem").write_bytes(certify(authority, "authority", True))
    for who in ("server", "client"):
        key = ec.generate_private_key(ec.SECP256R1())
        (folder / f"{who}.pem").write_bytes(certify(key, who))
        (folder / f"{who}.key").write_bytes(plain(key))
    (folder / "locked.key").write_bytes(plain(key, serialization.BestAvailableEncryption(b"atakatak")))
    return folder
