-- The prologue of every operation on an account.
--
-- KEYS are the account (a hash: budget, strategy, spent, leased), its leases (a hash by episode) and its verdicts (a
-- hash by episode and word of 64 steps). Episodes have 64 bits and remain text; units are at most 10^12, which a number
-- of Lua represents exactly.
--
-- Every operation returns the account's fields (none if there is no such account), numbers, and the indices of refused
-- charges.

local fields = redis.call('HMGET', KEYS[1], 'budget', 'strategy', 'spent', 'leased')
if not fields[1] then
  return {{}, {}, {}}
end
local budget, spent, leased = tonumber(fields[1]), tonumber(fields[3]), tonumber(fields[4])
-- The number of units in the first half of the budget.
local first_half = math.ceil(budget / 2)

local function decimal(units)
  return string.format('%.0f', units)
end

local function balance()
  return {fields[1], fields[2], decimal(spent), decimal(leased)}
end

local function save_account()
  redis.call('HSET', KEYS[1], 'spent', decimal(spent), 'leased', decimal(leased))
end

-- A lease is stored as its units, its early units, its spent units, and 1 if it is settled.
local function load_lease(episode)
  local text = redis.call('HGET', KEYS[2], episode)
  if not text then
    return false
  end
  local units, early_units, lease_spent, settled = string.match(text, '^(%d+) (%d+) (%d+) ([01])$')
  return {
    units = tonumber(units),
    early_units = tonumber(early_units),
    spent = tonumber(lease_spent),
    settled = settled == '1',
  }
end

local function save_lease(episode, lease)
  local numbers = {decimal(lease.units), decimal(lease.early_units), decimal(lease.spent)}
  local text = table.concat(numbers, ' ') .. (lease.settled and ' 1' or ' 0')
  redis.call('HSET', KEYS[2], episode, text)
end
