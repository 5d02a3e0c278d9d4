-- Accounts: the budget and the units charged. The checksum covers the account's name, budget and strategy, and its rows
-- in the other tables.
CREATE TABLE accounts (
    id INTEGER PRIMARY KEY,
    name TEXT NOT NULL UNIQUE,
    budget INTEGER NOT NULL,
    strategy TEXT NOT NULL,
    spent INTEGER NOT NULL,
    checksum INTEGER NOT NULL
) STRICT;

-- Units reserved for an episode; charged_before is the number of units charged to the episode before it had the lease.
-- Episode numbers from 2^63 on are stored less 2^64.
CREATE TABLE leases (
    account INTEGER NOT NULL REFERENCES accounts (id),
    episode INTEGER NOT NULL,
    units INTEGER NOT NULL,
    early_units INTEGER NOT NULL,
    charged_before INTEGER NOT NULL,
    settled INTEGER NOT NULL,
    PRIMARY KEY (account, episode)
) STRICT, WITHOUT ROWID;

-- The verdicts, one bit for each step: the steps asked about, those of them that were charged, and those of them whose
-- unit belongs to the first half of the budget. Bit b of word w is step 64 * w + b.
CREATE TABLE verdicts (
    account INTEGER NOT NULL REFERENCES accounts (id),
    episode INTEGER NOT NULL,
    word INTEGER NOT NULL,
    asked INTEGER NOT NULL,
    charged INTEGER NOT NULL,
    first_half INTEGER NOT NULL,
    PRIMARY KEY (account, episode, word)
) STRICT, WITHOUT ROWID;

-- One row for each charged unit.
CREATE VIEW charges (account, episode, step, half) AS
WITH RECURSIVE bits (bit) AS (
    SELECT 0 UNION ALL SELECT bit + 1 FROM bits WHERE bit < 63
)
SELECT
    accounts.name,
    CASE WHEN episode < 0 THEN printf('%u', episode) ELSE episode END,
    64 * word + bit,
    CASE WHEN (first_half >> bit) & 1 THEN 'first' ELSE 'second' END
FROM verdicts
JOIN accounts ON accounts.id = verdicts.account
JOIN bits ON (charged >> bit) & 1;
