-- What every operation on an account begins with.
--
-- KEYS are the account (a hash: budget, strategy, spent, leased), its leases (a hash by episode) and its verdicts (a
-- hash by episode and word of 64 steps). Episodes are 64 bits wide and stay text; units are at most 10^12 and exact as
-- numbers of Lua's.
--
-- Every operation answers with the account's fields, none when there is no such account, numbers, and the places of
-- what is refused.

local fields = redis.call('HMGET', KEYS[1], 'budget', 'strategy', 'spent', 'leased')
if not fields[1] then
  return {{}, {}, {}}
end
local budget, spent, leased = tonumber(fields[1]), tonumber(fields[3]), tonumber(fields[4])
-- How many units are handed out while more than half of the budget is left.
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

-- A lease is written as its units, its early units, what is spent of it, and 1 when it is settled.
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
